"""Drivers: the only clocks, sockets and threads of the loop; they know endpoints by contract."""
