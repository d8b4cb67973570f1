"""Websockets: ingest from nodes, live data for pages and programs."""
