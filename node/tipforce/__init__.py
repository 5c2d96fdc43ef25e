"""The CANopen stack for fingertip force sensors.

Where to begin, by what one wants to do:

- read, calibrate and configure fingers on a bus: `tipforce.host`; a whole hand: `tipforce.host.hand.hand`
- decode frames and logs: `tipforce.host.decoding.decoder`, `tipforce.host.logs.reader`
- compute force and contact from strain: `tipforce.sensor.contact.estimate`, `tipforce.sensor.structure.strain`
- fit a calibration: `tipforce.sensor.calibration.fit`
- run a fingertip node: `tipforce.fingertip.node`, `tipforce.running.loop`
- build another CANopen device: `tipforce.device.node`
- simulate: `tipforce.scene.run`, and faults on a bus: `tipforce.host.network.faulty_bus`

What goes wrong is raised as an error of `tipforce.errors`. Names have units (`force_newtons`, `theta_rad`); shapes are
written as (n, 3).
"""
