source /tmp/h5t/t.sh; N=6
for m in standard bin.model b3.model; do rm -f ad.model; t pdal-stages adapt a.laz --from $m --model ad.model; done
for f in noise one empty dup oneclass; do rm -f ad.model; t pdal-stages adapt $f.laz --model ad.model; done
t pdal-stages adapt a.laz noise.laz empty.laz --model ad.model
t pdal-stages classify one.laz o.laz --model ad.model
t pdal-stages train a.laz --base ad.model --model adb.model
t pdal-stages classify a.laz o.laz --model adb.model
t pdal-stages classify a.laz o.laz --model adb.model --keep-sure 0.9
t pdal-stages model adb.model
t pdal-stages review o.laz r.gpkg --model bin.model
t pdal-stages corrections a.laz o.laz corr.laz
