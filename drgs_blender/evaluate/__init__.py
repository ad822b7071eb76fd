"""How good an asset is: metrics, scenes with known truth, tables."""
