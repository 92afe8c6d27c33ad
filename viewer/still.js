// ?still=1: one picture of the first whole map, the same every time: nothing moves, nothing of the panel is in it. When it
// stands, the title of the page is a JSON of what is in it. ?mode=, ?section= and ?camera= choose what is seen.
export function stillCounts(mirror, map) {
  return {
    patches: mirror.patches.size, triangles: mirror.triangles, drawn: map.drawn, draws: map.group.children.length,
    step: mirror.step, map: mirror.hello?.map, generation: mirror.hello?.generation, cell: mirror.hello?.cell,
  };
}

export function finish(counts) {
  document.title = JSON.stringify(counts);
}
