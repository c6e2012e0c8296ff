//! A bounding-volume hierarchy over boxes, split at the median of the longest axis.

use super::raycast::Ray;
use glam::{Vec3, Vec3A};

/// Items in a leaf: an exact intersection costs several box tests, so that every item is worth its own box (measured: 1 is
/// faster than 2 by a quarter).
const LEAF_SIZE: usize = 1;

struct Node {
    low: Vec3A,
    high: Vec3A,
    /// Leaf: first index into `items`. Inner node: index of the second child; the first one follows its parent.
    next: u32,
    /// Items of a leaf, 0 for an inner node.
    num_items: u16,
    /// Axis along which the children of an inner node are sorted.
    axis: u16,
}

/// Hierarchy over the boxes it was built from; items are indices into them.
pub(super) struct Bvh {
    nodes: Vec<Node>,
    items: Vec<usize>,
}

impl Bvh {
    /// Builds over `(low, high)` corners.
    pub fn new(boxes: Vec<(Vec3, Vec3)>) -> Self {
        let mut bvh = Self { nodes: Vec::new(), items: (0..boxes.len()).collect() };
        if !boxes.is_empty() {
            bvh.build(&boxes, 0, boxes.len());
        }
        bvh
    }

    fn build(&mut self, boxes: &[(Vec3, Vec3)], start: usize, end: usize) {
        let items = &mut self.items[start..end];
        let empty = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        let around = |all: (Vec3, Vec3), one: (Vec3, Vec3)| (all.0.min(one.0), all.1.max(one.1));
        let (low, high) = items.iter().fold(empty, |all, &item| around(all, boxes[item]));
        let node = self.nodes.len();
        let axis = (high - low).max_position();
        let num_items = if items.len() <= LEAF_SIZE { items.len() as u16 } else { 0 };
        self.nodes.push(Node { low: low.into(), high: high.into(), next: start as u32, num_items, axis: axis as u16 });
        if num_items > 0 {
            return;
        }
        let center = |item: &usize| boxes[*item].0[axis] + boxes[*item].1[axis];
        items.sort_by(|a, b| center(a).total_cmp(&center(b)));
        let middle = start + items.len() / 2;
        self.build(boxes, start, middle);
        self.nodes[node].next = self.nodes.len() as u32;
        self.build(boxes, middle, end);
    }

    /// Calls `test` with every item whose box `ray` may enter before `t_max`; `test` returns the new `t_max`.
    pub fn visit(&self, ray: Ray, mut t_max: f32, mut test: impl FnMut(usize) -> f32) {
        if self.nodes.is_empty() {
            return;
        }
        let origin = Vec3A::from(ray.origin);
        let inverse = Vec3A::from(ray.direction).recip();
        let goes_up = ray.direction.cmpge(Vec3::ZERO);
        // Depth of a median split over 2³² items.
        let mut stack = [0u32; 32];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let index = stack[depth] as usize;
            let node = &self.nodes[index];
            let (a, b) = ((node.low - origin) * inverse, (node.high - origin) * inverse);
            let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
            if near > far || far < 0.0 || near >= t_max {
                continue;
            }
            if node.num_items > 0 {
                for &item in &self.items[node.next as usize..node.next as usize + usize::from(node.num_items)] {
                    t_max = test(item);
                }
            } else {
                // The nearer child is on top of the stack.
                let children = [node.next, index as u32 + 1];
                let is_first_nearer = goes_up.test(usize::from(node.axis));
                stack[depth] = children[usize::from(!is_first_nearer)];
                stack[depth + 1] = children[usize::from(is_first_nearer)];
                depth += 2;
            }
        }
    }
}
