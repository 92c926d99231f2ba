"""Exports of a run: compensation tables of controls behind a guard, tables as CSV, and a workbook."""
