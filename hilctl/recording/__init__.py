"""MCAP in and out: what a run leaves behind.

data.py              a recording in memory: arrays and facts
facts.py             names of facts that several modules use
schema.py            protobuf messages of the topics; codec.py converts between bytes and arrays
messages.py          messages from batches of the ring
writer.py            a file from messages
reader.py            a recording in memory, whole or in pieces, from a file, sound or not
builder.py           the same from records
ends.py              the facts at both ends of a file, without its samples
stretch.py           a time range of a run; index.py finds it in a finished file
validation.py        checks of facts and messages; segments.py of segments
read_budget.py       limits of work and memory per file
mcap_records.py      single records and chunks, maybe damaged
recovery_scan.py     all whole records of a file; truncated_chunks.py what is left of others
recover.py           a sound file from a truncated one; rewrite.py copies, safe_replace.py replaces
"""
