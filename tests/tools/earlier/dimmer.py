from tipforce.machine import DeviceApplication


class Dimmer(DeviceApplication):
    def on_write(self, _entry: object, value: object) -> int:
        return 0x06090031 if isinstance(value, int) and value > 1000 else 0
