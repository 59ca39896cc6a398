"""Prototype of the solver."""
from __future__ import annotations
from collections.abc import Mapping
from dataclasses import dataclass, field
import numpy as np
import scipy.sparse as sp
from mapserver.fleet.equations import *
from mapserver.fleet.passages import *
from mapserver.fleet.ledger import EPOCH_NS

ZERO_STD, SCALE_STD, ACROSS_STD = 0.0045, 0.045, 0.0045
TAU_S = 2*ZERO_STD**2/(8e-5)**2
C_STD, C_REL, SLOPE_STD, SLOPE_REL, RISE_STD, RISE_REL, GAP_STD = 0.004, 0.08, 0.006, 0.3, 0.02, 0.3, 0.5
SAME = 0.25
HUBER = 1.5
EDGE_M, EDGE_REL = 20.0, 1.0
BEND = 0.1
SETTLE, SETTLED = 0.35, 0.05
PLACE_M = 15.0
PLACE_STD = 0.004
RAMP_STD = 0.07
LEAST_C = 0.002

@dataclass
class Layout:
    epochs: int; machines: int
    @property
    def size(self): return self.epochs + 2*self.machines + 1
    def scale(self, m): return self.epochs + m
    def across(self, m): return self.epochs + self.machines + m
    @property
    def ramp(self): return self.epochs + 2*self.machines

def huber(res): return np.minimum(1.0, HUBER/np.maximum(np.abs(res), 1e-9))

def aggregate(keys, *values):
    first, group, count = grouped(keys)
    return first, count, [np.bincount(group, v, len(first))/count for v in values], group

def cells_equations(p, lay, n_cells):
    ok = np.isfinite(p.c_rr)
    sector = np.floor(np.arctan2(p.ahead[:,1], p.ahead[:,0])/(2*np.pi/SECTORS)+.5).astype(int) % SECTORS
    key = np.stack([p.epoch, p.cell, sector*2+(p.direction>0)], 1)[ok]
    first, count, (c, along, hx, hy), _ = aggregate(key, p.c_rr[ok], p.along[ok], p.ahead[ok,0], p.ahead[ok,1])
    e, cell, d, m = p.epoch[ok][first], p.cell[ok][first], p.direction[ok][first], p.machine[ok][first]
    return dict(e=e, cell=cell, d=d, m=m, c=c, along=along, hx=hx, hy=hy, count=count)

def slope_means(p, n_cells):
    e = p.along*p.ahead[:,0]-p.across*p.ahead[:,1]; n = p.along*p.ahead[:,1]+p.across*p.ahead[:,0]
    k = np.maximum(np.bincount(p.cell, minlength=n_cells),1)
    return np.bincount(p.cell, e, n_cells)/k, np.bincount(p.cell, n, n_cells)/k

def edges(p, se, sn):
    """pairs of stays EDGE_M apart across a bend, settled on both sides"""
    run = np.cumsum(~p.follows)
    s = se[p.cell]*p.ahead[:,0]+sn[p.cell]*p.ahead[:,1]
    step = np.hypot(*np.diff(p.place_m, axis=0, prepend=p.place_m[:1]).T); step[~p.follows]=0
    dist = np.cumsum(step)
    key = dist + run*1e6
    settle = SETTLE*EDGE_M
    lo = np.searchsorted(key, key-settle); hi = np.searchsorted(key, key+settle, side='right')-1
    # range of the slope around
    settled = np.ones(len(p), bool)
    bad = np.zeros(len(p)); bad[1:] = p.follows[1:]*(np.abs(np.diff(s))>SETTLED)
    cb = np.cumsum(bad)
    settled = cb[hi]==cb[lo]
    j = np.searchsorted(key, key+EDGE_M)
    i = np.arange(len(p)); ok = (j < len(p)); i, j = i[ok], j[ok]
    ok = (run[i]==run[j]) & np.isfinite(p.c_rr[i]) & np.isfinite(p.c_rr[j]) & settled[i] & settled[j]
    i, j = i[ok], j[ok]
    ds = s[j]-s[i]
    ok = np.abs(ds) > BEND
    return i[ok], j[ok], s

@dataclass
class Result:
    names: list; epochs: Epochs; z: np.ndarray; k: np.ndarray; a: np.ndarray; ramp: float; x: np.ndarray; cov: np.ndarray; prior: np.ndarray; infos: dict; lay: Layout; rounds: int; steps: np.ndarray; places: list = None; debug: dict = None

def solve(ledgers, use=("cells","crossings","heights","edges"), rounds=15, ramp_std=RAMP_STD):
    names = sorted(ledgers)
    p, ep, cells = passages({n: ledgers[n] for n in names})
    nc = len(cells); lay = Layout(len(ep.number), len(names)); P = lay.size
    g = cells_equations(p, lay, nc)
    n = len(g['c'])
    std_c = np.hypot(C_STD, C_REL*np.abs(g['c']))*np.sqrt((1-SAME)/g['count']+SAME)
    se, sn = slope_means(p, nc)
    sbar = se[g['cell']]*g['hx']+sn[g['cell']]*g['hy']
    cmean = np.bincount(g['cell'], g['c'], nc)/np.maximum(np.bincount(g['cell'], minlength=nc),1)
    eqs = {}
    def cells_A(C):
        share = g['d']*np.maximum(C[g['cell']], LEAST_C)+sbar
        return sparse(n, P, (g['e'], g['d']), (lay.scale(g['m']), g['d']*share))
    if 'cells' in use:
        eqs['cells'] = Equations(cells_A(cmean), sparse(n, nc, (g['cell'], np.ones(n))), g['c'], std_c)
    # gradients
    sector = np.floor(np.arctan2(p.ahead[:,1], p.ahead[:,0])/(2*np.pi/SECTORS)+.5).astype(int) % SECTORS
    first, count, (al, ac, hx, hy), _ = aggregate(np.stack([p.epoch, p.cell, sector],1), p.along, p.across, p.ahead[:,0], p.ahead[:,1])
    e, cell, m = p.epoch[first], p.cell[first], p.machine[first]; ng=len(e)
    std_g = np.hypot(SLOPE_STD, SLOPE_REL*np.hypot(al,ac))*np.sqrt((1-SAME)/count+SAME)
    if 'crossings' in use:
        A = sp.vstack([sparse(ng,P,(e,-np.ones(ng))), sparse(ng,P,(lay.across(m),np.ones(ng)))]).tocsr()
        B = sp.vstack([sparse(ng,2*nc,(cell,hx),(nc+cell,hy)), sparse(ng,2*nc,(cell,-hy),(nc+cell,hx))]).tocsr()
        eqs['crossings'] = Equations(A,B,np.concatenate([al,ac]),np.concatenate([std_g,std_g]))
    L = links(p)
    if 'heights' in use:
        first,count,(rise,per,slope,gap),_ = aggregate(np.stack([L.epoch,L.start,L.end,L.gap],1), L.rise_m, L.per_zero_m, L.slope, L.gap.astype(float))
        nl=len(first)
        std = np.hypot(np.hypot(RISE_STD, RISE_REL*slope), GAP_STD*gap)*np.sqrt((1-SAME)/count+SAME)
        eqs['heights'] = Equations(sparse(nl,P,(L.epoch[first],-per)), sparse(nl,nc,(L.end[first],np.ones(nl)),(L.start[first],-np.ones(nl))), rise, std)
    places=[]
    if 'edges' in use:
        i,j,s = edges(p,se,sn)
        if len(i):
            mid=(p.place_m[i]+p.place_m[j])/2
            ds=s[j]-s[i]
            steep=np.abs(s[j])-np.abs(s[i])
            sec=np.floor(np.arctan2(p.ahead[i,1],p.ahead[i,0])/(np.pi/2)+.5).astype(int)%4
            pk=np.stack([np.floor(mid[:,0]/PLACE_M),np.floor(mid[:,1]/PLACE_M),sec,np.sign(ds),p.direction[i]],1).astype(int)
            uniq,place=np.unique(pk,axis=0,return_inverse=True); place=place.ravel()
            first,count,(dc,dds,dst,cc),_=aggregate(np.stack([p.machine[i],place],1), p.c_rr[j]-p.c_rr[i], p.direction[i]*ds, steep, np.minimum(p.c_rr[i],p.c_rr[j]))
            ne=len(first); mm=p.machine[i][first]
            sd=np.sqrt(2)*np.hypot(C_STD,C_REL*cc)*EDGE_REL*np.sqrt((1-SAME)/count+SAME)
            npl=len(uniq)
            A=sp.vstack([sparse(ne,P,(lay.scale(mm),dds),(np.full(ne,lay.ramp),dst)), sparse(npl,P)]).tocsr()
            B=sp.vstack([sparse(ne,npl,(place[first],np.ones(ne))), sparse(npl,npl,(np.arange(npl),np.ones(npl)))]).tocsr()
            eqs['edges']=Equations(A,B,np.concatenate([dc,np.zeros(npl)]),np.concatenate([sd,np.full(npl,PLACE_STD)]))
            eqs['edges'].nplace=npl
            places=[(tuple(u), count[(place[first]==q)].sum(), dds[place[first]==q].mean(), dst[place[first]==q].mean(), dc[place[first]==q].mean()) for q,u in enumerate(uniq)]
    # prior
    E=lay.epochs; rows=[]; pr_c=[];pr_v=[];pr_s=[]
    prev=np.r_[-1, np.where(np.diff(ep.machine)==0, np.arange(E-1), -1)]
    dt=np.where(prev>=0, (ep.number-ep.number[prev])*EPOCH_NS*1e-9, np.inf)
    phi=np.where(prev>=0,np.exp(-dt/TAU_S),0.0)
    A0=sparse(P,P,(np.arange(P),np.ones(P)))
    A0=A0-sp.csr_matrix((phi,(np.arange(E),np.maximum(prev,0))),shape=(P,P))
    s0=np.concatenate([ZERO_STD*np.sqrt(1-phi**2),np.full(lay.machines,SCALE_STD),np.full(lay.machines,ACROSS_STD),[ramp_std]])
    prior=Equations(A0.tocsr(),sp.csr_matrix((P,0)),np.zeros(P),s0)
    prior_info=eliminate(prior,1/s0**2)[0]
    eqs['prior']=prior
    w={k:1/e.std**2 for k,e in eqs.items()}
    x=None
    for it in range(rounds):
        parts={k:eliminate(e,w[k]) for k,e in eqs.items()}
        Lam=sum(i.matrix for i,_ in parts.values()); vec=sum(i.vector for i,_ in parts.values())
        new=np.linalg.solve(Lam,vec)
        done = x is not None and np.max(np.abs(new-x))<1e-6
        x=new
        for k,e in eqs.items():
            e.y=ground(parts[k][1],x)
            r=residuals(e,x); rob=huber(r)
            if k=='edges': rob[-e.nplace:]=1/(1+r[-e.nplace:]**2)
            w[k]=rob/e.std**2
        if done: break
        if 'cells' in eqs and it>=1: eqs['cells'].A=cells_A(eqs['cells'].y)
    cov=np.linalg.inv(Lam)
    M=lay.machines
    steps=eqs['edges'].y if 'edges' in eqs else np.zeros(0)
    return Result(names,ep,x[:E],x[E:E+M],x[E+M:E+2*M],x[-1],x,cov,np.linalg.inv(prior_info.matrix),{k:i.matrix for k,(i,_) in parts.items()},lay,it+1,steps,places)
