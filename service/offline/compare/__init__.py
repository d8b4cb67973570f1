"""A session against a reference: aligned in time, errors with intervals, limits. Reads no file."""
