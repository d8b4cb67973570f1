"""The node: acquisition in a process of its own, a journal on disk, and the link to a server.

`run.py` joins the parts. The link is, from the outside in, `publisher` (dials, again and again),
`connection` (what goes each way), `sending` (which frames are next) and `flow` (how many at once).
Touches hardware through `service.rig`, and the disk through `storage.journal` and, for a recording
of its own, `storage.sessions`; serves no web page.
"""
