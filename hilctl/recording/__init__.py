"""MCAP in and out: what a run leaves behind.

data.py     a recording in memory: arrays and facts
facts.py    names of facts that several modules go by
schema.py   protobuf messages of the file's topics
messages.py from ring batches to messages, small ones by rows.py many at a time
writer.py   from messages to a file; mcap_file.py  its chunks and its index
reader.py   from a file, sound or not, to a recording in memory or in pieces, which gathering.py
            makes; wire.py  blocks between bytes and arrays, blocks.py gathers them by columns;
            ahead.py  chunks before they are asked for; ends.py  the facts at both its ends
stretch.py  a part of a run, by time; index.py  where it stands in a finished file
checks.py   what facts and messages must be; segments.py: the stretches of a run, odd_segments.py
            those that hilctl did not write; allowance.py: what reading a file may take
salvage.py  what is whole in a file; records.py takes records apart for it, chunks.py chunks, and
            torn.py what is left of those that are not whole
recover.py  from a file cut short to a sound one; rewrite.py copies, replace.py replaces
"""
