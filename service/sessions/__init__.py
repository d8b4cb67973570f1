"""A session from its streams: where it begins and ends, what it is made from, how it is sealed.

Rules that a server, a node alone and recovery after a crash share. They may read and write a data
folder through `storage`; they know no network and no node or server.
"""
