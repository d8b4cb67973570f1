"""Proofs for `foottile verify`: a module each for file, journal, session and folder.

Reads sessions and journals from the disk; writes nothing, takes no lock, asks no server.
"""
