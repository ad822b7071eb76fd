"""Job files for render farms: Slurm, OpenJD, Flamenco; and the check before a submission."""
