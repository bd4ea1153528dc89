"""The scene of the page: what is drawn, and what is dragged."""
