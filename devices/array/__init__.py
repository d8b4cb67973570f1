"""Array of tiles behind multiplexers: start-up, schedules, scans, plausibility of readings."""
