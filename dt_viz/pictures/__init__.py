"""Pictures on the slice, and of ψ itself, as data."""
