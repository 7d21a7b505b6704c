//! Exact HDBSCAN: kd-tree core distances, Boruvka spanning tree, condensed tree, selection.
