"""A node's clock against the server's: measurements, their files, and the bounds they give.

Its files lie in the folders of sessions and journals; it imports neither, and refers to streams
only by their `stream_id`.
"""
