"""The tables of the papers on learned temporal denoising, remade: one file a table, ``python -m`` makes them all."""
