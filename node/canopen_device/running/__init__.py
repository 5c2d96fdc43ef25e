"""Run any CANopen device on a bus: the loop, the ports, the parameter store."""
