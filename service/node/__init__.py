"""Node: acquisition in a separate process, a journal on disk, and the link to a server.

`run` combines the parts. The link consists, from the outside in, of `publisher` (connects with
retries), `connection` (messages in both directions), `sending` (order of frames) and `flow` (flow
control). It uses hardware through `service.rig`, and the disk through `storage.journal` and, for
local recording, `storage.sessions`; it serves no web page.
"""
