//! Thin dark borders that undistortion leaves: pixels at the rim that are darker than what lies further in, in nearly all photographs.

use gs_io::Result;
use gs_scene::Image;
use gs_scene::dataset::View;
use rayon::prelude::*;
use stage::Stage;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Fewest photographs of a size that tell, and the most that are looked at.
const FEWEST: usize = 8;
const MOST: usize = 24;
/// Width of a border at most, as a share of the shorter side.
const WIDEST: f64 = 0.02;
/// A pixel is dark beside one further in with less than this share of its brightness; that one must be this bright to tell.
const DARK: f32 = 0.6;
const TELLS: f32 = 0.1;
/// Share of the photographs in which a pixel is dark, and of a side's places whose outermost pixel is dark.
const NEARLY_ALL: f64 = 0.9;
const SIDE: f64 = 0.5;
/// Pixels beyond the dark ones that do not count either: they are a mixture.
const MIXED: usize = 1;

/// By width and height of photographs: a value for each pixel.
pub(super) type BySize = BTreeMap<(u32, u32), Arc<Vec<f32>>>;

/// Of each size of photographs that has a border: 0 for pixels that lie in it, 1 for others.
pub(super) fn find(views: &[&View], stage: &Stage) -> Result<BySize> {
    let mut by_size: BTreeMap<(u32, u32), Vec<&View>> = BTreeMap::new();
    views.iter().for_each(|v| by_size.entry((v.camera.width, v.camera.height)).or_default().push(v));
    let mut borders = BTreeMap::new();
    for (size, views) in by_size.into_iter().filter(|(_, views)| views.len() >= FEWEST) {
        stage.go_on()?;
        let count = views.len().min(MOST);
        let grey = |k: usize| views[k * views.len() / count].load_image().map(|image| brightness(&image));
        let greys = (0..count).into_par_iter().map(grey).collect::<Result<Vec<_>>>()?;
        if let Some(inside) = inside(&greys, size.0 as usize, size.1 as usize) {
            let outside = inside.iter().filter(|v| **v == 0.0).count();
            let share = 100.0 * outside as f64 / inside.len() as f64;
            stage
                .info(&format!("nearly all photographs have a dark border: {share:.1} % of their pixels do not count"));
            borders.insert(size, Arc::new(inside));
        }
    }
    Ok(borders)
}

fn brightness(image: &Image) -> Vec<f32> {
    image.rgb.as_chunks::<3>().0.iter().map(|[r, g, b]| (r + g + b) / 3.0).collect()
}

/// 1 for pixels within the border that `greys` have in common, 0 for others; none without a border.
fn inside(greys: &[Vec<f32>], w: usize, h: usize) -> Option<Vec<f32>> {
    let depth = ((WIDEST * w.min(h) as f64) as usize).max(2);
    if w.min(h) < 4 * depth {
        return None;
    }
    let mut inside = vec![1.0; w * h];
    let mut any = false;
    // Of each side: its length, where its first place lies, the steps along it and inwards.
    let sides = [(w, 0, 1, w as isize), (w, (h - 1) * w, 1, -(w as isize)), (h, 0, w, 1), (h, w - 1, w, -1)];
    for (length, first, along, inwards) in sides {
        let at = |place: usize, k: usize| (first + place * along).wrapping_add_signed(k as isize * inwards);
        let dark = |place: usize, k: usize| {
            let (own, further) = (at(place, k), at(place, k + depth));
            let tells = greys.iter().filter(|g| g[further] > TELLS);
            let count = tells.clone().count();
            let dark = tells.filter(|g| g[own] < DARK * g[further]).count();
            count >= FEWEST && dark as f64 >= NEARLY_ALL * count as f64
        };
        let runs: Vec<usize> = (0..length).map(|place| (0..depth).take_while(|&k| dark(place, k)).count()).collect();
        if (runs.iter().filter(|run| **run > 0).count() as f64) < SIDE * length as f64 {
            continue;
        }
        any = true;
        for (place, run) in runs.into_iter().enumerate().filter(|(_, run)| *run > 0) {
            (0..run + MIXED).for_each(|k| inside[at(place, k)] = 0.0);
        }
    }
    any.then_some(inside)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (60, 50);

    /// Photographs of other things, with `edge` columns of this brightness on the left.
    fn greys(count: usize, edge: usize, value: f32) -> Vec<Vec<f32>> {
        let pixel = |i: usize, x: usize, y: usize| {
            let bright = 0.55 + 0.4 * ((i * 37 + x / 7 * 11 + y / 5 * 5) as f32).sin();
            if x < edge { value * bright } else { bright }
        };
        let one = |i: usize| (0..SIZE.0 * SIZE.1).map(|p| pixel(i, p % SIZE.0, p / SIZE.0)).collect();
        (0..count).map(one).collect()
    }

    #[test]
    fn a_border_is_found_where_nearly_all_photographs_have_it() {
        let find = |greys: &[Vec<f32>]| inside(greys, SIZE.0, SIZE.1);
        assert_eq!(find(&greys(20, 0, 0.0)), None);
        assert_eq!(find(&greys(4, 1, 0.0)), None, "too few photographs");
        // A whole black column, and one that is mixed with the picture.
        for value in [0.0, 0.4] {
            let inside = find(&greys(20, 1, value)).unwrap();
            let row = &inside[20 * SIZE.0..21 * SIZE.0];
            assert!(row[0] == 0.0 && row[3..].iter().all(|v| *v == 1.0), "{row:?}");
            assert!(inside.iter().filter(|v| **v == 0.0).count() <= 2 * SIZE.1);
        }
        // What is dark far into the picture is the scene, as below a turntable.
        assert_eq!(find(&greys(20, 30, 0.0)), None);
        // A third without it.
        assert_eq!(find(&[greys(14, 1, 0.0), greys(7, 0, 0.0)].concat()), None);
    }
}
