"""The one place the version is written; the manifest is checked against it by a test."""

__version__ = "0.1.0"
