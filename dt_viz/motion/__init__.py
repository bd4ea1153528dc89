"""From a scenario to its motion, and what is to be said of it."""
