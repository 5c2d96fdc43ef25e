"""The cases about the objects of a fingertip; importing a module declares its cases."""
