"""Node: acquisition in a separate process, a journal on disk, and the link to a server.

`running_node` combines the parts. The link consists, from the outside in, of `publisher` (connects
with retries), `server_connection` (messages in both directions) and `frame_sender` (order of frames
and flow control). It uses hardware through `service.rig`, and the disk through `storage.journal`
and, for local recording, `storage.sessions`; it serves no web page.
"""
