"""What a session is made of, where it begins and ends, how it is sealed; no network.

The rules that a server, a node alone and recovery after a crash share. They read and write a data
folder through `storage`, and import neither `service.node` nor `service.server`.
"""
