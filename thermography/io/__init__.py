"""Reads and writes files: radiometric JPEG, FFF, SEQ and CSQ, stacks of fields as zarr, maps as OpenEXR."""
