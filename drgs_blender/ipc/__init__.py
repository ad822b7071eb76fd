"""The client's half of the engine: messages, transport, child process. numpy only: the extension uses it."""
