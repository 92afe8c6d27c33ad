// Somebody else's readers of MCAP on a recording: the indexed one and the streaming one, CRCs checked. One JSON object with what each found.
//   node mcap_read.mjs PACKAGES FILE
import { createRequire } from "node:module";
import { open, readFile } from "node:fs/promises";
import path from "node:path";

const [packages, file] = process.argv.slice(2);
const require = createRequire(path.join(path.resolve(packages), "package.json"));
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { FileHandleReadable } = require("@mcap/nodejs");
const { loadDecompressHandlers } = require("@mcap/support");

const decompressHandlers = await loadDecompressHandlers();

function tally() {
  return { messages: 0, topics: {}, last: 0n, ordered: true, first: null, end: null };
}

function count(t, topic, message) {
  t.messages++;
  t.topics[topic] = (t.topics[topic] ?? 0) + 1;
  t.ordered &&= message.logTime >= t.last;
  t.last = message.logTime;
  t.first ??= message.logTime;
  t.end = message.logTime;
}

async function indexed() {
  const handle = await open(file, "r");
  const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(handle), decompressHandlers });
  const t = tally();
  for await (const message of reader.readMessages()) count(t, reader.channelsById.get(message.channelId).topic, message);
  t.statistics = {
    messages: reader.statistics.messageCount,
    chunks: reader.statistics.chunkCount,
    start: reader.statistics.messageStartTime,
    end: reader.statistics.messageEndTime,
    channels: reader.statistics.channelCount,
    attachments: reader.statistics.attachmentCount,
  };
  t.attachments = [];
  for await (const attachment of reader.readAttachments({ validateCrcs: true })) t.attachments.push([attachment.name, attachment.data.byteLength]);
  t.metadata = [];
  for await (const metadata of reader.readMetadata()) t.metadata.push([metadata.name, Object.fromEntries(metadata.metadata)]);
  await handle.close();
  return t;
}

async function streamed() {
  const reader = new McapStreamReader({ validateCrcs: true, decompressHandlers });
  const t = tally();
  const topics = new Map();
  reader.append(await readFile(file));
  for (let record = reader.nextRecord(); record; record = reader.nextRecord()) {
    if (record.type === "Channel") topics.set(record.id, record.topic);
    if (record.type === "Message") count(t, topics.get(record.channelId), record);
  }
  t.done = reader.done();
  return t;
}

const found = { indexed: await indexed(), streamed: await streamed() };
console.log(JSON.stringify(found, (_, value) => (typeof value === "bigint" ? value.toString() : value)));
