"""What each chip is: registers and data-sheet formulas over a bus. Nothing here knows an array."""
