"""Inter-process communication with the engine: messages, transport by pipe and shared memory, and the client.

Both sides use the messages and the transport (`protocol`, `codec`, `slots`, `shared_memory`); the client (`client`,
`child_process`, `handshake`, `watchdog`) starts the engine process, sends it frames and watches its heartbeats.
numpy only: the extension imports this package inside Blender.
"""
