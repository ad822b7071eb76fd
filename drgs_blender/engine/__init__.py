"""The engine process: the server on pipes, the session that renders frames, the caches between frames."""
