//! What truly stands on, in and under what, by rays through the exact scene; and how often `objects` tells it from the points
//! that cameras see. `cargo test --release -p synth-scene relations -- --ignored --nocapture` prints the table of
//! docs/objects.md.

use crate::options::Options;
use crate::render;
use crate::scene::{Family, Scene};
use crate::testing::chart_points;
use artifacts::{Instances, Remarks};
use glam::DVec3;
use gs_scene::Gaussians;
use objects::{Names, RelationKind, describe};
use std::collections::{BTreeMap, BTreeSet, HashSet};

type Told = BTreeSet<(u32, RelationKind, u32)>;

/// Height within which a thing touches what carries it, and below which parts of it are its foot, metres.
const CONTACT: f64 = 0.012;
/// Side of the cells of which one point each is kept, metres.
const CELL: f64 = 0.01;
/// Fewest points of a thing that cameras see.
const FEWEST: u32 = 30;

/// Points all over the surface of each thing, with normals.
fn surfaces(scene: &Scene) -> Vec<Vec<(DVec3, DVec3)>> {
    let mut all = vec![Vec::new(); scene.things.len()];
    for p in &scene.primitives {
        let points = chart_points(&p.shape, 12).map(|at| p.shape.surface(at));
        all[p.thing as usize].extend(points.map(|(at, normal)| (p.to_world(at), p.rotation * normal)));
    }
    all
}

/// The things along a ray, nearest first, without `own`.
fn along(scene: &Scene, own: u32, from: DVec3, direction: DVec3, far: f64) -> Vec<u32> {
    let (mut found, mut near) = (Vec::new(), 0.0);
    while let Some(hit) = scene.trace(from, direction, near).filter(|hit| hit.t <= far) {
        let thing = scene.primitives[hit.primitive].thing;
        if thing != own && !found.contains(&thing) {
            found.push(thing);
        }
        near = hit.t + 1e-6;
    }
    found
}

/// On: most of the foot's points lie at most 12 mm above the other. In: of eight level directions and downward from the
/// middle, seven meet the other. Under: over half of what faces up has the other above it first, and doesn't carry it.
fn truth(scene: &Scene) -> Told {
    let mut told = Told::new();
    for (a, points) in surfaces(scene).iter().enumerate() {
        let own = a as u32;
        let low = points.iter().map(|p| p.0.z).fold(f64::INFINITY, f64::min);
        let high = points.iter().map(|p| p.0.z).fold(f64::NEG_INFINITY, f64::max);
        let middle = points.iter().map(|p| p.0).sum::<DVec3>() / points.len() as f64;
        let middle = middle.with_z(0.5 * (low + high));
        let mut met = BTreeMap::<u32, usize>::new();
        let level = (0..8).map(|i| DVec3::new((f64::from(i) * 0.785).cos(), (f64::from(i) * 0.785).sin(), 0.0));
        for direction in level.chain([DVec3::NEG_Z]) {
            along(scene, own, middle, direction, 3.0).iter().for_each(|b| *met.entry(*b).or_default() += 1);
        }
        let room = |b: u32| ["floor", "wall", "ceiling"].contains(&scene.things[b as usize].class);
        let inside: BTreeSet<u32> = met.into_iter().filter(|m| m.1 >= 7 && !room(m.0)).map(|m| m.0).collect();
        told.extend(inside.iter().map(|&b| (own, RelationKind::In, b)));

        let foot: Vec<DVec3> = points.iter().map(|p| p.0).filter(|p| p.z <= low + CONTACT).collect();
        if let Some(b) = most(&foot, |p| along(scene, own, *p + DVec3::Z * CONTACT, DVec3::NEG_Z, 2.0 * CONTACT), 0.5)
            && !inside.contains(&b)
        {
            told.insert((own, RelationKind::On, b));
        }
        let top: Vec<DVec3> = points.iter().filter(|p| p.1.z > 0.5).map(|p| p.0).collect();
        if let Some(b) = most(&top, |p| along(scene, own, *p, DVec3::Z, f64::INFINITY), 0.5)
            && !inside.contains(&b)
        {
            told.insert((own, RelationKind::Under, b));
        }
    }
    // What carries or holds another does not lie under it, nor does what stands on its lower part.
    let carried = told.clone();
    let held = |a, b| carried.contains(&(a, RelationKind::On, b)) || carried.contains(&(a, RelationKind::In, b));
    told.retain(|&(a, kind, b)| kind != RelationKind::Under || !held(a, b) && !held(b, a));
    told
}

/// What more than a share of the points meet first.
fn most(points: &[DVec3], meets: impl Fn(&DVec3) -> Vec<u32>, share: f64) -> Option<u32> {
    let mut votes = BTreeMap::<u32, usize>::new();
    points.iter().filter_map(|p| meets(p).first().copied()).for_each(|b| *votes.entry(b).or_default() += 1);
    let (b, count) = votes.into_iter().max_by_key(|v| v.1)?;
    (count as f64 > share * points.len() as f64).then_some(b)
}

/// What `objects` tells of labelled points.
fn told(points: &[(DVec3, u32)], things: usize) -> (Told, BTreeSet<u32>) {
    let mut count = vec![0u32; things];
    points.iter().for_each(|p| count[p.1 as usize] += 1);
    let kept: Vec<&(DVec3, u32)> = points.iter().filter(|p| count[p.1 as usize] >= FEWEST).collect();
    let n = kept.len();
    let gaussians = Gaussians {
        means: kept.iter().map(|p| p.0.as_vec3().to_array()).collect(),
        log_scales: vec![[-5.0; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![3.0; n],
        sh: vec![0.0; 3 * n],
        sh_degree: 0,
        ..Gaussians::default()
    };
    let instances = Instances {
        label: kept.iter().map(|p| p.1 as i32).collect(),
        node: vec![-1; n],
        score: vec![1.0; things],
        support: vec![0; things],
        count,
        centroid: vec![[0.0; 3]; things],
        ..Instances::default()
    };
    let up = "z".parse().ok();
    let scene = describe(&instances, &gaussians, &Remarks::default(), &Names::new(), up, BTreeMap::new());
    let told = scene.relations.iter().map(|r| (r.subject, r.relation, r.object)).collect();
    (told, scene.objects.iter().map(|o| o.id).collect())
}

/// What the cameras see of each thing: a point in each cell.
fn seen(scene: &Scene, options: &Options) -> Vec<(DVec3, u32)> {
    let (mut cells, mut points) = (HashSet::new(), Vec::new());
    for camera in options.cameras(scene) {
        let (frame, eye) = (render::identify(scene, &camera), camera.position());
        for at in (0..frame.thing.len()).filter(|&at| frame.thing[at] >= 0) {
            let (x, y) = ((at % frame.width) as f64 + 0.5, (at / frame.width) as f64 + 0.5);
            let p = eye + render::ray(&camera, x, y) * frame.distance[at];
            if cells.insert((frame.thing[at], (p / CELL).floor().to_array().map(|v| v as i32))) {
                points.push((p, frame.thing[at] as u32));
            }
        }
    }
    points
}

/// Found, told and true relations of a kind.
#[derive(Default, Clone, Copy)]
struct Tally {
    right: usize,
    told: usize,
    truth: usize,
}

/// Compares what is told with the truth, on scenes of these families and seeds, and prints the table.
fn compare(families: &[Family], seeds: std::ops::Range<u64>) -> [Tally; 4] {
    let mut all = [Tally::default(); 4];
    eprintln!("| family | relation | true | told | precision | recall |\n|---|---|---|---|---|---|");
    for &family in families {
        let mut tallies = [Tally::default(); 4];
        for seed in seeds.clone() {
            let options =
                Options { seed, family, objects: 20, views: 16, width: 200, height: 150, ..Options::default() };
            let scene = options.scene();
            let things = scene.things.len();
            let (found, ids) = told(&seen(&scene, &options), things);
            let mut truth = truth(&scene);
            // Neighbours: the rule itself, of whole surfaces.
            let whole = surfaces(&scene);
            let whole = whole.iter().enumerate().flat_map(|(a, points)| points.iter().map(move |p| (p.0, a as u32)));
            let related = |a: u32, b: u32| truth.iter().any(|t| (t.0, t.2) == (a, b) || (t.0, t.2) == (b, a));
            let (exact, _) = told(&whole.collect::<Vec<_>>(), things);
            let next_to = |t: &(u32, RelationKind, u32)| t.1 == RelationKind::NextTo && !related(t.0, t.2);
            let neighbours: Told = exact.into_iter().filter(next_to).collect();
            truth.extend(neighbours);
            truth.retain(|t| ids.contains(&t.0) && ids.contains(&t.2));
            for (tally, kind) in tallies.iter_mut().zip(KINDS) {
                tally.told += found.iter().filter(|t| t.1 == kind).count();
                tally.truth += truth.iter().filter(|t| t.1 == kind).count();
                tally.right += found.intersection(&truth).filter(|t| t.1 == kind).count();
            }
        }
        for (k, t) in tallies.iter().enumerate() {
            print(&format!("{family:?}"), KINDS[k], *t);
            all[k] = Tally { right: all[k].right + t.right, told: all[k].told + t.told, truth: all[k].truth + t.truth };
        }
    }
    all.iter().enumerate().for_each(|(k, t)| print("all", KINDS[k], *t));
    all
}

const KINDS: [RelationKind; 4] = [RelationKind::On, RelationKind::In, RelationKind::Under, RelationKind::NextTo];

fn share(part: usize, of: usize) -> f64 {
    part as f64 / of.max(1) as f64
}

#[test]
fn what_stands_on_a_table_is_told() {
    let [on, _, _, next_to] = compare(&[Family::Table], 0..1);
    assert!(on.truth > 15 && share(on.right, on.told) > 0.9 && share(on.right, on.truth) > 0.7);
    assert!(next_to.truth > 15 && share(next_to.right, next_to.told) > 0.9);
}

#[test]
#[ignore = "minutes: the table of docs/objects.md"]
fn relations_of_five_families() {
    let families = [Family::Studio, Family::Table, Family::Kitchen, Family::Room, Family::Workshop];
    let [on, ..] = compare(&families, 0..2);
    assert!(on.truth > 100 && share(on.right, on.told) > 0.9 && share(on.right, on.truth) > 0.7);
}

fn print(family: &str, kind: RelationKind, t: Tally) {
    let share = |of: usize| if of == 0 { "–".into() } else { format!("{:.2}", t.right as f64 / of as f64) };
    eprintln!("| {family} | {kind:?} | {} | {} | {} | {} |", t.truth, t.told, share(t.told), share(t.truth));
}
