// Reads MCAP files with @mcap/core, twice each: by their index, and as a stream from start to end,
// checksums checked. Prints one JSON object: path to what was found, or to an error.
//
//     node read_mcap.mjs FILE...          or paths as lines of standard input: node read_mcap.mjs -

import { readFileSync } from "node:fs";

import zstd from "@foxglove/wasm-zstd";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";

await zstd.isLoaded;
const decompressHandlers = {
  zstd: (data, size) => new Uint8Array(zstd.decompress(data, Number(size))),
};

function count(counts, topic) {
  counts[topic] = (counts[topic] ?? 0) + 1;
}

async function indexed(bytes) {
  const readable = {
    size: async () => BigInt(bytes.length),
    read: async (offset, size) => bytes.subarray(Number(offset), Number(offset + size)),
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const counts = {};
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    count(counts, reader.channelsById.get(message.channelId).topic);
  }
  const metadata = {};
  for await (const record of reader.readMetadata()) {
    metadata[record.name] = Object.fromEntries(record.metadata);
  }
  const attachments = [];
  for await (const record of reader.readAttachments({ validateCrcs: true })) {
    attachments.push(record.name);
  }
  const counted = Number(reader.statistics.messageCount);
  return { counts, counted, metadata, attachments, chunks: reader.chunkIndexes.length };
}

function streamed(bytes) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  reader.append(bytes);
  const counts = {};
  const topics = new Map();
  for (let record; (record = reader.nextRecord()); ) {
    if (record.type === "Channel") topics.set(record.id, record.topic);
    if (record.type === "Message") count(counts, topics.get(record.channelId));
  }
  return { counts, done: reader.done(), left: reader.bytesRemaining() };
}

const named = process.argv.slice(2);
const paths = named[0] === "-" ? readFileSync(0, "utf8").split("\n").filter(Boolean) : named;
const found = {};
for (const path of paths) {
  try {
    const bytes = new Uint8Array(readFileSync(path));
    found[path] = { indexed: await indexed(bytes), streamed: streamed(bytes) };
  } catch (error) {
    found[path] = { error: String(error) };
  }
}
console.log(JSON.stringify(found));
