"""The library: what `import dt_viz` offers of motions, and of hands and arms that follow them."""
