"""Readers of untrusted files, bounded in time and memory."""
