"""MCAP in and out: what a run leaves behind.

data.py     a recording in memory: arrays and facts
schema.py   protobuf messages of the file's topics
writer.py   from ring records to a file
reader.py   from a file to a recording in memory
"""
