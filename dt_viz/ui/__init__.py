"""The page: the only folder that talks to the browser."""
