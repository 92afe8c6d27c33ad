#!/bin/sh
# Law: daemon -> drivers -> config -> core, never the other way (design, section 2). One wrong include anywhere is refused.
. "$(dirname "$0")/lib.sh"
tools/lint layers . || { echo "an include points the wrong way"; exit 1; }
cp -r core config drivers daemon tools "$scratch"
for wrong in core/vec.h:config/config.h config/keys.c:drivers/driver.h drivers/table.c:daemon/pipeline.h daemon/worker.c:tools/output.h \
    core/grid.c:daemon/pipeline.h; do
    file=${wrong%%:*} included=${wrong#*:}
    cp "$file" "$scratch/kept"
    printf '#include "%s"\n' "$included" >>"$scratch/$file"
    said=$(tools/lint layers "$scratch") && { echo "FAILED: $file may include $included"; failed=1; }
    [ "$(echo "$said" | wc -l)" -eq 1 ] || { echo "FAILED: $file with $included gives: $said"; failed=1; }
    cp "$scratch/kept" "$scratch/$file"
done
exit $failed
