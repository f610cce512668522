"""Verify a link: probe it, predict what was asked, and judge what was measured."""
