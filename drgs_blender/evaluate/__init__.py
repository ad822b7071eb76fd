"""Evaluation of assets: metrics, scenes with known truth, tables."""
