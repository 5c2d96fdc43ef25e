"""Test any CANopen device by clause of CiA 301, CiA 302-2 and CiA 305: `python -m canopen_conformance --help`.
Independent of the devices that it tests, on purpose: it needs python-can and the standard library alone, and states the
numbers of the standards itself. A caller may add cases of its own (``case.all_cases``) for its own product.
"""
