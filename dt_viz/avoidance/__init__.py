"""Diffeomorphisms that are stacked on what was learned."""
