"""Certificates, and who may publish what."""
