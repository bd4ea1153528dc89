"""Learning of stable motions from demonstrations."""
