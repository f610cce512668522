"""The guard on board: states and rules that hold whatever the cloud sends."""
