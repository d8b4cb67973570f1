"""Batch processing of many sessions: locations, jobs, results and SQL queries."""
