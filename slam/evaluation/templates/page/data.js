// The page's data: base64 of gzip of a JSON head and arrays, see slam/evaluation/page_blob.py.
"use strict";
(S => {
  const KINDS = {
    f4: Float32Array, f8: Float64Array, i1: Int8Array, i2: Int16Array, i4: Int32Array, i8: BigInt64Array,
    u1: Uint8Array, u2: Uint16Array, u4: Uint32Array,
  };

  // Arrays are flat; `shape` gives rows and columns.
  function found(value, buffer, start) {
    if (Array.isArray(value)) return value.map(one => found(one, buffer, start));
    if (value === null || typeof value !== "object") return value;
    if ("dtype" in value && "offset" in value) {
      const length = value.shape.reduce((product, size) => product * size, 1);
      const array = new KINDS[value.dtype](buffer, start + value.offset, length);
      return Object.assign(array, {shape: value.shape});
    }
    return Object.fromEntries(Object.entries(value).map(([name, one]) => [name, found(one, buffer, start)]));
  }

  S.decode = async text => {
    const letters = atob(text.trim());
    const bytes = new Uint8Array(letters.length);
    for (let at = 0; at < letters.length; at++) bytes[at] = letters.charCodeAt(at);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const buffer = await new Response(stream).arrayBuffer();
    const size = new DataView(buffer).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
    return found(head, buffer, 4 + size);
  };
})(Scanweave);
