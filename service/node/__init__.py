"""The node: acquisition in a process of its own, a journal on disk, and the link to a server.

`run.py` joins the parts. The link is, from the outside in, `publisher` (dials, again and again),
`connection` (what goes each way), `sending` (which frames are next) and `flow` (how many at once).
May touch hardware by `service.rig` and the disk by `storage.journal`; serves no web page.
"""
