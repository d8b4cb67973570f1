"""What files prove of themselves: `foottile verify`.

Reads sessions and journals as they lie on the disk; writes nothing, takes no lock, asks no server.
"""
