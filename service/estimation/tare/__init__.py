"""The tare: by hand, by its lead, in flight, and how baselines drift between tares."""
