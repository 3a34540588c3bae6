# docker build -t pdal-stages .
# docker run --rm -v "$PWD:/data" -v pdal-stages-kernels:/var/cache/pdal-stages pdal-stages classify raw.laz classified.laz
#
# Every step is one of scripts/container, which says what it does and also runs without Docker.

FROM debian:12-slim AS build
WORKDIR /opt/pdal_stages
COPY scripts scripts
RUN scripts/container tools
RUN scripts/container pdal
COPY . .
RUN scripts/container package

FROM debian:12-slim
COPY --from=build /opt/pdal_stages /opt/pdal_stages
RUN /opt/pdal_stages/scripts/container runtime
RUN /opt/pdal_stages/scripts/container user
USER pdal-stages
WORKDIR /data
ENTRYPOINT ["pdal-stages"]
