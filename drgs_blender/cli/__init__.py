"""The command line `drgs`: one module per command."""
