"""The data contract, numpy only: frames, assets, passes (AOVs), simulation materials, particle caches, errors."""
