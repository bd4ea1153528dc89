"""DT-Viz: diffeomorphic transforms for generalised imitation learning, live in the browser."""
