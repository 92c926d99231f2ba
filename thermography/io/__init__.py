"""Frames as recorded (level 0): radiometric JPEG, FFF, SEQ and CSQ read and written, stacks of frames, OpenEXR maps."""
