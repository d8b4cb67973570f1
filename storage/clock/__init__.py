"""A node's clock against the server's: measurements, their files, and the bounds they give.

Its files lie in the folders of sessions and journals; it imports neither, and knows streams only by
their `boot_id`.
"""
