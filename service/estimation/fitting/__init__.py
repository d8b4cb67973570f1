"""From a bench recording to a calibration: checks, fits and intervals. No estimate needs it."""
