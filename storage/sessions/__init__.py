"""Recorded sessions on disk: folder, description, sealed file, and the ledger of their frames."""
