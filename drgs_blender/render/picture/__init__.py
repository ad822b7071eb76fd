"""From light to pixels: film, denoising, frames on disk."""
