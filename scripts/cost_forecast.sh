#!/usr/bin/env bash
# cost_forecast.sh FORECAST: what a whole scene may take, in one line, from the numbers that geometry_forecast.sh wrote: Gaussians,
# pixels and photographs. GRAPH_ARGS, FEAT_ARGS and MAKES_MASKS (SAM has to) are taken from the environment. Nothing of this
# was measured at such sizes: docs/reproduce.md says what each figure comes from.
set -euo pipefail
levels=4
[[ ${GRAPH_ARGS-} =~ --levels[=\ ]([a-z0-9,-]+) ]] && levels=$(tr ',' '\n' <<< "${BASH_REMATCH[1]}" | wc -l)
closed=1
[[ ${FEAT_ARGS-} =~ --preset|--method ]] && closed=0
awk -v levels="$levels" -v closed="$closed" -v masks="${MAKES_MASKS:+1}" -v cores="$(nproc)" '
  function most(a, b) { return a > b ? a : b }
  function least(a, b) { return a < b ? a : b }
  {
    megabytes = $1; geometry = $2; n = $3; pixels = $4; views = $5
    # make demo (44,915 Gaussians, 26 views of 480 x 360): 4,345,891 entries, nearly one for each Gaussian, view and level.
    entries = 0.93 * n * views * levels
    size = n / 44915; more = views / 26; larger = pixels / 172800
    graph = 4.42 * size ^ 0.64 * more ^ 1.12 * larger ^ 0.62
    features = 400 + 2 * 8 * entries / 2 ^ 20
    instances = 14 * size ^ 0.84 * more ^ 0.89 * larger ^ 0.64
    sam = masks ? 6 * views : 0
    memory = most(megabytes * 2 ^ 20, 19.4e6 + 500 * n + 157 * pixels + 20400 * views)
    # 40 masks of a view and level, each of which shares Gaussians with 600.
    memory = most(memory, closed ? 3.8e8 + 940 * n + 36 * 600 * 40 * views * levels \
      : 4.7e6 + 518 * n + least(14 * entries, 2 ^ 29) + 26 * entries / views / levels)
    many = 2 ^ 27 # entries that clustering by masks keeps of single Gaussians
    memory = most(memory, 15.5e6 + most(1250 * n, 650 * n + most(10 * least(entries, many), 3 * entries)))
    disk = 725 * n + 20 * entries + (masks ? 7.7e6 * views : 0)
    hours = (geometry + graph + features + instances + sam) / 3600
    printf "at most %.1f CPU hours (%s%.1f geometry, %.1f graph, %.1f features, %.1f instances), ", hours, \
      masks ? sprintf("%.1f masks, ", sam / 3600) : "", geometry / 3600, graph / 3600, features / 3600, instances / 3600
    printf "%.1f hours on %d cores; %.1f GB of memory, %.1f GB on disk; %d Gaussians, %d photographs\n", \
      hours / cores, cores, memory / 1e9, disk / 1e9, n, views
  }' "$1"
