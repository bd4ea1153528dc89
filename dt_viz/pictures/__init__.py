"""What is drawn on the slice and of ψ itself."""
