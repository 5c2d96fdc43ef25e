"""Test any CANopen device by clause of CiA 301, CiA 302-2 and CiA 305: `python -m canopen_conformance --help`.
Independent of all devices on purpose: it states the numbers of the standards itself and needs python-can alone."""
