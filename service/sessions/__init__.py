"""Rules of sessions: their beginning, parts, ends and inputs, and how they are sealed; no network.

Shared by server, node and recovery. They read and write a data folder through `storage`, and import
neither `service.node` nor `service.server`.
"""
