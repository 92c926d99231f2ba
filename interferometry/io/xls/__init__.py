"""Spreadsheets of Excel 97 to 2003 (.xls): looked into before the reader, which takes every size that they state."""
