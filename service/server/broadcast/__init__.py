"""Broadcast of summaries to the live page's subscribers, and the JSON shapes of the API."""
