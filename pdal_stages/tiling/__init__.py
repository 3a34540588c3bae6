"""Run pipelines over inputs of any number and size: tiles with a halo, without seams.

Words of this room:

- **in tiles, per output**: the stages up to the last one that sees neighbors run on a tile and its
  surroundings; those after it, with the writers, on the points of one output.
- **halo**: what is read around a tile, in meters (``_m``) or units of the coordinates (``_units``).
  A tile that was read too narrowly is read again with a wider halo.
- **piece**: the points of one input in a tile and its halo, as a temporary LAS file.
- **round**: stages in tiles that run on the whole survey, and save their results, before the next
  round's stages see these. The last round runs on the tiles.
- **square**: several tiles together, which the rounds before the last one run on.
- **block**: a square of a far-reaching stage's raster (:class:`..stages.base.FarReaching`),
  computed between two rounds; its grid is not that of the tiles.
- **job**: a tile, square, block or output, or an input that is to be read, and its state.
- **digest** of a job: fingerprint of everything that affects its result; ``--resume`` keeps what
  has the same one.
- **origin** of a point (``_ORIGIN`` of :mod:`.run_tile`): the dimensions that say from which row of
  which piece it comes, and how far outside the tile it lies.

Each word has a type: ``TilePlan.in_tiles`` and ``per_output``, :class:`.rounds.Round`,
``Round.halo_m``, :class:`.sorted_points.Piece`, :class:`.options.TileGrid` of tiles and squares,
:class:`..stages.base.Blocks`, :class:`.jobs.Job`. A tile is made in five steps, read, join, run,
and save or write: :func:`.run_tile.run_tile`.
"""
