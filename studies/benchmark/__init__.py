"""Benchmark of run time and error of model sets, over many random draws of emulated scenes."""
