"""The conformance cases of a fingertip: its own objects, and what it guarantees beyond the standards."""

from canopen_conformance.case import Product

FINGERTIP = Product("tipforce", 0x54500000, 0xFFF00000, write_only_index=0x2104)
