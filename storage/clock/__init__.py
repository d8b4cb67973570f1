"""A node's clock against the server's: measurements, their files, and the bounds they give.

Knows streams by their `boot_id`, and nothing of sessions or journals.
"""
