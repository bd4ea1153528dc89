"""Readers of files that anyone may have written: bounded in time and memory."""
