"""What sessions are written in: a module for each format, named in one registry.

A module makes a `Format` (`storage.formats.written.format`) of a generator that gets an `Export`
and yields the file's bytes, and `storage.formats.written.registry` names it. REST, `foottile
export`, `foottile pull` and the page's menu follow from that. The generator

- takes frames from `Export.pieces`, numpy columns of some thousand rows, or `Export.tables`, the
  same as Arrow, and yields what it made of one before it takes the next, so that memory stays
  bounded; a format that cannot do so takes `Export.whole`, which refuses more than `frames_max`;
- raises before its first chunk what can be known by then, since that is still an answer, and later
  errors break a download off; it never ends a file that lacks something as if it were whole;
- states in the file what `Export.about` and `Export.all_notes` say, the time base, axes, and what
  it resampled, filled or left out;
- imports packages that are heavy, or of an extra, inside of it; `Format.extra` names the extra.
"""
