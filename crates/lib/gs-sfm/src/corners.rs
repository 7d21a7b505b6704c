//! What the photographs themselves say of where things and cameras are: corners that several photographs show are matched,
//! placed, and fitted.
//!
//! * `detect`: corners of a photograph and their descriptions
//! * `pairs`: which photographs are compared, and what they have in common
//! * `tracks`: corners that are one point, and where it lies
//! * `adjust`: poses, focal lengths and points that fit together
//!
//! All is in double precision and does not depend on the number of threads.

mod adjust;
mod detect;
mod pairs;
#[cfg(test)]
mod tests;
mod tracks;

use crate::{Refine, median};
use adjust::{Bundle, Slack};
use detect::{Corners, LONGEST, detect};
use glam::{DVec2, DVec3};
use gs_io::Result;
use gs_scene::dataset::{Split, View};
use gs_scene::{Camera, Image, PointCloud, image_size};
use pairs::{EXACT, matches, partners};
use rayon::prelude::*;
use stage::Stage;
use tracks::{Point, Sighting, error, join, limit, place};

/// Fewest points that tell whether the poses are good.
const FEWEST_POINTS: usize = 100;
/// Limits of a corner's error while poses are found, in [`EXACT`]s, and beyond which it counts less.
const ROUNDS: [[f64; 2]; 4] = [[24.0, 4.0], [6.0, 2.0], [2.0, 1.0], [1.0, 0.5]];
/// What is enough to choose other poses than those given: an error of so many [`EXACT`]s, and so many times that of the best ones
/// (docs/results/handheld.md).
const FITS: f64 = 0.25;
const LEAST_GAIN: f64 = 1.25;
/// How far a corner may be off along given poses, in medians of all, and at most.
const SPREAD: f64 = 3.0;
const SLACKEST: f64 = 8.0;
/// Fewest corners by which a view's pose is found.
const FEWEST_SEEN: usize = 12;

/// Makes a small picture of the photograph that a camera took.
type Shrink = fn(&Image, &Camera) -> Image;

/// What the photographs tell.
#[derive(Default)]
pub struct Found {
    /// Of all views.
    pub cameras: Vec<Camera>,
    /// Whether these are others than those given.
    pub refined: bool,
    /// Points that training views show, with their colours.
    pub points: PointCloud,
    /// Small pictures of the training views, where they were asked for.
    pub pictures: Vec<Image>,
}

/// Corners of all views, and which of them are one point.
struct Sights<'a> {
    views: &'a [&'a View],
    corners: Vec<Corners>,
    tracks: Vec<Vec<Sighting>>,
}

/// Places the corners that training views share, with the cameras as they are given, or, where `refine` says so, with cameras that
/// fit the corners: first those of the training views, with their focal lengths, then those of the others on the points found. `small`
/// asks for small pictures, too.
pub fn find(views: &[&View], refine: Refine, small: Option<Shrink>, stage: &Stage) -> Result<Found> {
    let given: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
    let learns: Vec<bool> = views.iter().map(|v| v.split == Split::Train).collect();
    let mut sights = Sights { views, corners: vec![Corners::default(); views.len()], tracks: Vec::new() };
    let pictures = sights.look(&given, &learns, small, stage)?;
    let (before, spread) = sights.placed(&given, &learns, SLACKEST);
    let as_given = |sights: &Sights<'_>, pictures| {
        let (points, _) = sights.placed(&given, &learns, (SPREAD * spread).clamp(1.0, SLACKEST));
        Found { points: sights.cloud(&points), cameras: given.clone(), pictures, refined: false }
    };
    if refine == Refine::Off {
        let found = as_given(&sights, pictures);
        stage.info(&format!(
            "{} points from corners, which the poses miss by {} in the median",
            found.points.len(),
            pixels(&given, spread)
        ));
        if spread > 1.0 && found.points.len() >= FEWEST_POINTS {
            stage.warn("the poses do not fit the photographs well: --refine-poses finds better ones");
        }
        return Ok(found);
    }
    let (mut cameras, expected) = sights.fitted(&given, &learns, stage)?;
    let (points, after) = sights.placed(&cameras, &learns, 1.0);
    if refine == Refine::Auto {
        let (pays, said) = sights.pays(&given, &cameras, &learns);
        stage.info(&format!("--refine-poses auto: {said}"));
        if !pays {
            return Ok(as_given(&sights, pictures));
        }
    }
    let cloud = sights.cloud(&points);
    // The others, each by the points that it shows.
    let others: Vec<bool> = learns.iter().map(|l| !l).collect();
    sights.look(&given, &others, None, stage)?;
    let (mut points, _) = sights.placed(&cameras, &learns, 1.0);
    sights.show(&mut points, &learns);
    let free = sights.held(&points, &others);
    let lenses = lenses(&given);
    for [_, width] in ROUNDS {
        let (cameras, points) = (&mut cameras[..], &mut points[..]);
        let slack = expected;
        Bundle { cameras, given: &given, lenses: &lenses, free: &free, points, slack, all: false }.adjust(width);
    }
    stage.info(&format!(
        "poses from {} corners, which they miss by {} in the median; those given missed {} by {}",
        cloud.len(),
        pixels(&cameras, after),
        before.len(),
        pixels(&given, spread)
    ));
    let placed = (0..views.len()).filter(|&v| sights.count(&points, v) >= FEWEST_SEEN).count();
    if placed < views.len() {
        stage.warn(&format!("{} of {} photographs have too few corners in common with others: the corners leave their poses as they are", views.len() - placed, views.len()));
    }
    Ok(Found { cameras, refined: true, points: cloud, pictures })
}

/// Bytes that [`find`] takes at once on so many threads, besides decoded photographs.
pub fn bytes(views: &[&View], threads: u64) -> Result<u64> {
    let of = |v: &&View| image_size(&v.image_path).map(detect::bytes);
    Ok(threads * views.iter().map(of).collect::<Result<Vec<u64>>>()?.into_iter().max().unwrap_or(0))
}

/// An error of so many [`EXACT`]s, in words.
fn pixels(cameras: &[Camera], error: f64) -> String {
    format!("{:.2} pixels", error * limit(&cameras[0], EXACT))
}

/// The lens of each camera, by number: those of equal intrinsics are one.
pub fn lenses(cameras: &[Camera]) -> Vec<usize> {
    let same = |a: &Camera, b: &Camera| {
        (a.width, a.height) == (b.width, b.height) && [a.fx, a.fy, a.cx, a.cy] == [b.fx, b.fy, b.cx, b.cy]
    };
    let mut firsts: Vec<&Camera> = Vec::new();
    let of = cameras.iter().map(|c| {
        firsts.iter().position(|f| same(f, c)).unwrap_or_else(|| {
            firsts.push(c);
            firsts.len() - 1
        })
    });
    of.collect()
}

impl<'a> Sights<'a> {
    /// Finds the corners of the views of `of`, and joins those of all that have some; `cameras` are those given. The small pictures that were
    /// asked for.
    fn look(&mut self, cameras: &[Camera], of: &[bool], small: Option<Shrink>, stage: &Stage) -> Result<Vec<Image>> {
        let up = cameras.iter().map(|c| c.rotation.transpose() * -DVec3::Y).sum::<DVec3>();
        let own: Vec<usize> = (0..of.len()).filter(|&v| of[v]).collect();
        let mut progress = stage.progress("photograph", own.len() as u64);
        let mut pictures = Vec::new();
        // Few at a time: each takes the memory of a decoded photograph several times.
        for part in own.chunks(2 * rayon::current_num_threads()) {
            stage.go_on()?;
            let one = |&i: &usize| {
                let v = self.views[i];
                // The corners of a photograph are finer than the pictures that are learnt from.
                let image = v.load_image_within(LONGEST)?;
                let mut corners = detect(&image, roll(&v.camera, up));
                let to = [v.camera.width, v.camera.height].map(f64::from);
                let from = [image.width, image.height].map(f64::from);
                corners
                    .at
                    .iter_mut()
                    .flatten()
                    .zip([0, 1].into_iter().cycle())
                    .for_each(|(x, k)| *x *= to[k] / from[k]);
                Ok((corners, small.map(|small| small(&image, &v.camera))))
            };
            let found = part.par_iter().map(one).collect::<Result<Vec<_>>>()?;
            for (&i, (corners, small)) in part.iter().zip(found) {
                self.corners[i] = corners;
                pictures.extend(small);
                progress.step();
            }
        }
        progress.finish(&[]);
        let pairs = partners(cameras);
        let corners = &self.corners;
        let compare = |&[i, j]: &[usize; 2]| ([i, j], matches([&corners[i], &corners[j]], [&cameras[i], &cameras[j]]));
        let found: Vec<_> = pairs.par_iter().map(compare).collect();
        stage.go_on()?;
        let counts: Vec<usize> = corners.iter().map(|c| c.at.len()).collect();
        stage.info(&format!(
            "{} corners in {} photographs, {} matches in {} of {} pairs",
            counts.iter().sum::<usize>(),
            counts.iter().filter(|n| **n > 0).count(),
            found.iter().map(|(_, m)| m.len()).sum::<usize>(),
            found.iter().filter(|(_, m)| !m.is_empty()).count(),
            pairs.len()
        ));
        self.tracks = join(&counts, &found);
        Ok(pictures)
    }

    /// The cameras, of which those of the views of `learns` fit the corners, and how far those given are off.
    fn fitted(&self, given: &[Camera], learns: &[bool], stage: &Stage) -> Result<(Vec<Camera>, Slack)> {
        let lenses = lenses(given);
        let (mut cameras, mut off) = (given.to_vec(), None);
        for [slack, width] in ROUNDS {
            stage.go_on()?;
            let (mut points, _) = self.placed(&cameras, learns, slack);
            let free = self.held(&points, learns);
            let slack = off.unwrap_or_else(|| Slack::widest(depth(&points, &cameras)));
            let (points, all) = (&mut points[..], true);
            Bundle { cameras: &mut cameras, given, lenses: &lenses, free: &free, points, slack, all }.adjust(width);
            off = Some(slack.learnt(&cameras, given, &free));
        }
        Ok((cameras, off.expect("one round at least")))
    }

    /// Whether cameras that fit the corners of the views of `learns` are to be taken for those given, and why.
    fn pays(&self, given: &[Camera], fitted: &[Camera], learns: &[bool]) -> (bool, String) {
        // With the same slack: else wrong matches would count for one of both alone.
        let [was, is] = [given, fitted].map(|cameras| self.placed(cameras, learns, SLACKEST).1);
        let (points, _) = self.placed(fitted, learns, 1.0);
        let of = |flags: &[bool]| flags.iter().filter(|f| **f).count();
        // Where corners hold few of the photographs, they say more about these than about the others.
        let held = 3 * of(&self.held(&points, learns)) >= 2 * of(learns) && points.len() >= FEWEST_POINTS;
        let pays = held && was > LEAST_GAIN * is && was > FITS;
        let does = match (pays, held) {
            (true, _) => "poses are refined",
            (false, true) => "poses stay as they are given",
            (false, false) => "too few photographs have corners in common, poses stay as they are given",
        };
        let [was, is] = [was, is].map(|e| pixels(given, e));
        let count = points.len();
        (
            pays,
            format!("{count} corners miss the given poses by {was} in the median, and the best ones by {is}: {does}"),
        )
    }

    fn at(&self, s: Sighting) -> DVec2 {
        DVec2::from_array(self.corners[s.view].at[s.corner])
    }

    /// The points of the tracks by the views of `of`, and the median of their errors, in [`EXACT`]s.
    fn placed(&self, cameras: &[Camera], of: &[bool], slack: f64) -> (Vec<Point>, f64) {
        let one = |(i, track): (usize, &Vec<Sighting>)| {
            let seen = track.iter().filter(|s| of[s.view]).map(|&s| (s, self.at(s))).collect();
            place(i, seen, cameras, slack)
        };
        let points: Vec<Point> = self.tracks.par_iter().enumerate().filter_map(one).collect();
        let errors = points.iter().flat_map(|p| {
            p.seen.iter().filter_map(|(s, at)| {
                let c = &cameras[s.view];
                Some(error(c, p.place, *at)?.length() / limit(c, EXACT))
            })
        });
        let errors: Vec<f64> = errors.collect();
        let spread = if errors.is_empty() { 0.0 } else { median(errors) };
        (points, spread)
    }

    /// In how many of the points a view is.
    fn count(&self, points: &[Point], view: usize) -> usize {
        points.iter().filter(|p| p.seen.iter().any(|(s, _)| s.view == view)).count()
    }

    /// Those of the views of `of` that see enough to be placed.
    fn held(&self, points: &[Point], of: &[bool]) -> Vec<bool> {
        let mut counts = vec![0; self.corners.len()];
        points.iter().flat_map(|p| &p.seen).for_each(|(s, _)| counts[s.view] += 1);
        counts.iter().zip(of).map(|(&n, &of)| of && n >= FEWEST_SEEN).collect()
    }

    /// Adds to points where views other than those of `of` show them.
    fn show(&self, points: &mut [Point], of: &[bool]) {
        for p in points {
            let track = &self.tracks[p.track];
            p.seen.extend(track.iter().filter(|s| !of[s.view]).map(|&s| (s, self.at(s))));
        }
    }

    fn cloud(&self, points: &[Point]) -> PointCloud {
        let color = |p: &Point| {
            let of = |c: usize| {
                let sum: u32 = p.seen.iter().map(|(s, _)| u32::from(self.corners[s.view].colors[s.corner][c])).sum();
                (sum / p.seen.len() as u32) as u8
            };
            [of(0), of(1), of(2)]
        };
        PointCloud {
            positions: points.iter().map(|p| p.place.as_vec3().to_array()).collect(),
            colors: points.iter().map(color).collect(),
            ..PointCloud::default()
        }
    }
}

/// The direction of the world's "up" in a picture, in radians from the picture's own; 0 where the camera looks along it.
fn roll(c: &Camera, up: DVec3) -> f64 {
    let up = c.rotation * up.normalize_or_zero();
    if up.truncate().length() < 0.3 { 0.0 } else { up.x.atan2(-up.y) }
}

/// The median distance of points from the cameras that show them; 0 without points.
fn depth(points: &[Point], cameras: &[Camera]) -> f64 {
    let all = points.iter().flat_map(|p| p.seen.iter().map(|(s, _)| cameras[s.view].to_camera(p.place).z));
    let all: Vec<f64> = all.collect();
    if all.is_empty() { 0.0 } else { median(all) }
}
