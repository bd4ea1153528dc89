"""Small programs that use the library: read them, copy them, change them."""
