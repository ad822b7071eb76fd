"""The `drgs` command; one module a command."""
