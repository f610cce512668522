"""The quadrotor of the paper: AscTec Pelican class, with a rigid arm."""
