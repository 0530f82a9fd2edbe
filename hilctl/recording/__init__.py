"""MCAP in and out: what a run leaves behind.

data.py          a recording in memory: arrays and facts
facts.py         names of facts that several modules use
schema.py        protobuf messages of the file's topics; codec.py  blocks between bytes and arrays
messages.py      from ring batches to messages
writer.py        from messages to a file
reader.py        from a file, sound or not, to a recording in memory or in pieces, which builder.py
                 makes; ends.py  the facts at both its ends
stretch.py       a part of a run, by time; index.py  its place in a finished file
checks.py        validation of facts and messages; segments.py  of the segments
allowance.py     limits of work and memory per file
salvage.py       all whole records of a file, by mcap_records.py; torn.py  what
                 is left of truncated chunks
recover.py       from a truncated file to a sound one; rewrite.py copies, replace.py replaces
"""
