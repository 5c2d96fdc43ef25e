// The bins of all fingers, by their number: time = number x width.
// A row has for each finger the minima, maxima and uncertainties of its quantities, and the number of unknown rows.
export class Bins {
  constructor(widthMs, quantities) {
    this.widthMs = widthMs;
    this.quantities = quantities;
    this.fields = 3 * quantities + 1;
    this.rows = new Map();
    this.keys = null; // sorted bin numbers, if computed
  }

  add(bins) {
    bins.i.forEach((index, n) => this.set(index, bins.v[n]));
  }

  set(index, row) {
    if (!this.rows.has(index)) this.keys = null;
    this.rows.set(index, row);
  }

  // Calls with (time, row) for each bin of a span, in the order of time.
  each(fromMs, toMs, call) {
    this.keys ??= [...this.rows.keys()].sort((a, b) => a - b);
    for (const index of this.keys) {
      const t = index * this.widthMs;
      if (t >= fromMs - this.widthMs && t <= toMs) call(t, this.rows.get(index));
    }
  }

  prune(firstMs) {
    const first = Math.floor(firstMs / this.widthMs) - 2;
    for (const index of this.rows.keys()) {
      if (index < first) {
        this.rows.delete(index);
        this.keys = null;
      }
    }
  }

  // Calls with (time, low, high, row) for each bin of a curve; low is null where unknown. Values below 0 get `turn` more.
  values({ finger, quantity, turn = 0 }, fromMs, toMs, call) {
    const at = finger * this.fields + quantity;
    this.each(fromMs, toMs, (t, row) => {
      const low = row[at] ?? null, high = row[at + this.quantities], more = low !== null && low + high < 0 ? turn : 0;
      call(t, low === null ? null : low + more, high + more, row);
    });
  }

  // {low, high, u} of the bin nearest to a time, at most `within` away; null for none, or one without a value.
  nearest({ finger, quantity }, t, within) {
    const index = Math.floor(t / this.widthMs), low = finger * this.fields + quantity, q = this.quantities;
    for (let away = 0; away * this.widthMs <= within; away += 1) {
      const row = this.rows.get(index - away) ?? this.rows.get(index + away);
      if (row) return (row[low] ?? null) === null ? null : { low: row[low], high: row[low + q], u: row[low + 2 * q] };
    }
    return null;
  }

  // [{t, low, high, u, unknown}] of one quantity of one finger, in the order of time; low is null where unknown.
  series(curve, fromMs, toMs) {
    const found = [], base = curve.finger * this.fields, q = this.quantities;
    this.values(curve, fromMs, toMs, (t, low, high, row) => {
      if (row.length < base + this.fields) return;
      found.push({ t, low, high, u: row[base + 2 * q + curve.quantity], unknown: row[base + 3 * q] });
    });
    return found;
  }
}
