"""Links on their own: between programs and streams, under test, drawn, recorded, and changed."""
