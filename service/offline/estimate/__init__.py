"""Re-estimation of sessions: complete, a time range, or chunk by chunk."""
