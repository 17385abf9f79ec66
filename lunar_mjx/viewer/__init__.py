"""A drivable rover: in MuJoCo's window, or on a web page that this machine alone can open."""
