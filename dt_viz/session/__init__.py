"""Scenario to frames for one visitor, and the session that edits it."""
