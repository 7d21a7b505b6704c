// Sorts Gaussians from far to near in a worker. The function below is the whole program of the worker.

export function sorter() {
  let positions, keys, order, other;
  const counts = new Uint32Array(65536);
  // A number of 0 to 65535 that has nothing to do with where Gaussian i lies: a share of these is a fair sample.
  const chance = (i) => (Math.imul(i, 0x9e3779b1) >>> 16);
  onmessage = ({ data }) => {
    if (data.positions) {
      positions = data.positions;
      const n = positions.length / 3;
      keys = new Float32Array(n);
      order = new Uint32Array(n);
      other = new Uint32Array(n);
      return;
    }
    const { forward, offset, near, share, id } = data;
    const n = positions.length / 3, most = share * 65536, bits = new Uint32Array(keys.buffer);
    let m = 0;
    for (let i = 0; i < n; i++) {
      const z = forward[0] * positions[3 * i] + forward[1] * positions[3 * i + 1] + forward[2] * positions[3 * i + 2] + offset;
      if (z < near || chance(i) >= most) continue;
      keys[i] = z;
      order[m++] = i;
    }
    // The bits of positive numbers sort as the numbers do. Two passes of 16 bits, far before near.
    for (const shift of [0, 16]) {
      counts.fill(0);
      for (let k = 0; k < m; k++) counts[65535 - (bits[order[k]] >>> shift & 65535)]++;
      for (let k = 0, sum = 0; k < 65536; k++) [counts[k], sum] = [sum, sum + counts[k]];
      for (let k = 0; k < m; k++) other[counts[65535 - (bits[order[k]] >>> shift & 65535)]++] = order[k];
      [order, other] = [other, order];
    }
    const sorted = order.slice(0, m);
    postMessage({ sorted, id }, [sorted.buffer]);
  };
}
