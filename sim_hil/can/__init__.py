"""Simulated CAN: bus, drives and arm, as peers on the wire with a codec of their own."""
