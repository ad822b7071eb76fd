"""The path integrator: sample allocation, direct light by multiple importance sampling, indirect light."""
