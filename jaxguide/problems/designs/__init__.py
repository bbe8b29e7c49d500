"""Designs ready to tune, by name: see `jaxguide.problems.design`."""
