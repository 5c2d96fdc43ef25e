"""Test any CANopen device by clause of CiA 301, CiA 302-2 and CiA 305: `python -m canopen_conformance --help`.
Independent of the devices: it states the standards' numbers itself. ``case.all_cases`` takes a caller's own cases."""
