"""Simulate towns, drives through them, and the sensors of a car: data for everyone."""
