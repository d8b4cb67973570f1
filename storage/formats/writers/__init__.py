"""Writers of export formats: one module a format, one registry of all.

A module defines an `ExportFormat` (`storage.formats.writers.format`) with a generator that gets one
`Export`, or several, and yields the file's bytes; `storage.formats.writers.registry` lists it.
REST, `foottile export`, `foottile pull` and the page's menu use the registry. The generator

- reads frames from `Export.read_chunks`, numpy columns of some thousand rows, or
  `Export.read_tables`, the same as Arrow, and yields the bytes of one chunk before it reads the
  next, so that memory is bounded; a format that needs all frames uses `Export.read_all`, which
  refuses more than `frames_max`;
- raises as many errors as possible before its first chunk: a client then gets an error response,
  while later errors abort a download; it never completes an incomplete file;
- writes `Export.metadata` and `Export.notes_with_clock_and_markers` into the file, with time base,
  axes, and facts about resampled, filled or omitted data;
- imports heavy packages, and packages of an extra, inside of itself; `ExportFormat.extra` names the
  extra.
"""
