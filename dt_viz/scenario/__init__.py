"""Every choice of the user as values, and edits of them."""
