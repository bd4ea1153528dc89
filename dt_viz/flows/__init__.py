"""Point fields, their flows, and systems seen through them."""
