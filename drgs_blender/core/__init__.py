"""The data contract: frames, assets, passes, errors. numpy only, so that the extension may use it."""
