"""Routes of recorded data: sessions, takes, markers, plots, verification."""
