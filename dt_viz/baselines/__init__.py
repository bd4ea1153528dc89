"""Methods that ours is compared with: the paper's (sec. 5, Table 1), and what came after."""
