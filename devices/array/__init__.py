"""Array of tiles behind multiplexers: start-up, schedules, scans, screening, bus recovery."""
