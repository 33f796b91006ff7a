"""Presentation of results: tables, figures and exports."""
