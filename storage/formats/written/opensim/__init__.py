"""OpenSim: what acts on each foot as rows without a gap, and the files that say so."""
