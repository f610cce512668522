"""Recording: records go in; a hash, MCAP files and columns of numbers come out.

`topics` says what is recorded, `hash` identifies a run, `recorder` and `writer` keep it,
`columns` reads it back, `merge` puts both ends on one clock. What `cloudrc[record]` installs is
imported only by `ros_types`, `writer` and `reader`.
"""
