"""Several processes that serve one address: who starts them, what they share, and how connections get to them."""
