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

const protobuf = require("protobufjs");
const descriptor = require("protobufjs/ext/descriptor");

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

// What was published, read by the schemas that the file carries: counts, and the entities that a viewer would show at the end.
const decoders = new Map();
function decode(reader, channel, data) {
  const schema = reader.schemasById.get(channel.schemaId);
  if (!decoders.has(schema.id)) {
    const root = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data));
    decoders.set(schema.id, root.lookupType(schema.name));
  }
  return decoders.get(schema.id).decode(data);
}

function show(scene, update) {
  for (const deletion of update.deletions) {
    if (deletion.type === 1) scene.clear();
    else scene.delete(deletion.id);
  }
  for (const entity of update.entities) scene.set(entity.id, entity.triangles.reduce((n, list) => n + list.indices.length / 3, 0));
}

async function indexed() {
  const handle = await open(file, "r");
  const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(handle), decompressHandlers });
  const t = tally(), scene = new Map();
  t.decoded = 0;
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    count(t, channel.topic, message);
    if (channel.messageEncoding !== "protobuf") continue;
    const decoded = decode(reader, channel, message.data);
    t.decoded++;
    if (channel.topic === "/map") show(scene, decoded);
  }
  t.entities = scene.size;
  t.triangles = [...scene.values()].reduce((a, b) => a + b, 0);
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
