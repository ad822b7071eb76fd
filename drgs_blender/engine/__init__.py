"""The engine process: protocol, server, session, client."""
